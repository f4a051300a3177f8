"""The part of `--help` below the flags."""

GLOSSARY = """\
names and symbols:
  support         Theta, the box that parameters are drawn from; heuristics adapt it
  feasible        Phi, the limits that no adapted support leaves
"""
"""The part of the glossary in `--help` that is not made from the heuristics' hyperparameters."""

MAIN_EXAMPLES = """\
examples:
  jaxlfi tasks                                   list the built-in tasks
  jaxlfi infer lotka_volterra --support misspecified --heuristic edge --out runs/edge
  jaxlfi compare lotka_volterra --seeds 10 --out runs/comparison
  jaxlfi grid lotka_volterra --vary expansion=0.1,0.2,0.4 --out runs/grid
  jaxlfi resume runs/comparison                  continue an interrupted run; the result is bit-for-bit the same
  jaxlfi sample runs/edge -n 1000                draws from the posterior, in natural units
  jaxlfi diagnose runs/edge                      are the credible intervals calibrated?
  jaxlfi report runs/comparison                  draw the figures again

Bad input ends with one line on stderr and exit status 2; nothing is ever overwritten.
"""

INFER_EXAMPLES = """\
examples:
  jaxlfi infer lotka_volterra --support misspecified --heuristic edge --out runs/edge
  jaxlfi infer lotka_volterra --mass-threshold 0.01 --expansion 0.1 0.1 0.2 0.2 --out runs/gentle
  jaxlfi infer spring:task --observation real.csv --support-low 1 0.1 --support-high 10 1 --out runs/spring
  jaxlfi infer lotka_volterra --preset paper --seeds 4 --out runs/paper
  jaxlfi infer whip --object dlo-0 --heuristic edge --out runs/dlo-0
  jaxlfi infer whip --object dlo-2 rollout-7.npz --out runs/two-rollouts

"""

COMPARE_EXAMPLES = """\
A configuration is SUPPORT (kept fixed) or SUPPORT+HEURISTIC. All configurations and seeds run in parallel, with the
same observation for the same seed, and with the same number of rounds, whether or not their posteriors settle.

examples:
  jaxlfi compare lotka_volterra --seeds 10 --out runs/comparison
  jaxlfi compare lotka_volterra --configurations ok broad broad+centre --seeds 20 --out runs/broad

"""

GRID_EXAMPLES = """\
Every combination of values is run with every seed, in parallel, in chunks that fit into memory; the same seed means
the same observation in all of them. Hyperparameters that do not vary keep the values of their flags, or the defaults.

examples:
  jaxlfi grid lotka_volterra --support misspecified --out runs/edge-grid \\
      --vary zone_fraction=0.05,0.1,0.2 mass_threshold=0.001,0.005,0.05 expansion=0.1,0.2,0.4
  jaxlfi grid lotka_volterra --heuristic mode --vary proximity=0.2,0.4 --vary expansion=0.1,0.2 --out runs/mode-grid

"""

RESUME_EXAMPLES = """\
examples:
  jaxlfi resume runs/edge                        finish an interrupted run; the result is bit-for-bit the same
  jaxlfi resume runs/edge --simulations 3000     continue until the run has 3,000 simulations in all
  jaxlfi resume runs/edge --rounds 30            continue to 30 rounds in all
"""

DIAGNOSE_EXAMPLES = """\
Truths are drawn from the run's own posterior and from the prior over a support, and simulated; the run's method then
infers a posterior for each. If the run had one round and kept its network (--method npe, or --rounds 1
--keep-network), the network is evaluated once per truth. Otherwise the whole inference is repeated for each truth, in
parallel, which takes about as long as that many runs. Chunks are saved as they finish, and repeating the command
continues an interrupted one. The exit status is 0 even if checks fail.

widths of each parameter's intervals, at each reference:
  calibrated    90 % intervals covered 90 % of the truths, and their width is known to be right to within 1.5
  too narrow    they covered fewer; the number says how many times as wide they would have to be. too wide: more
  biased        truths lie to one side of the intervals' medians
  undecided     too few truths to tell
  At the posterior: is the method calibrated near this run's result? Over a support: for all kinds of objects?

checks, over a support:
  rank          of each truth among its draws, by parameter (simulation-based calibration)
  coverage      how often the densest region of a level contains the truth; around random points (TARP)
  classifier    accuracy of a classifier that separates truths from draws, given the simulation
  predictive    whether the run's own observation looks like simulations of its own posterior
verdicts:
  over-confident, under-confident: posteriors are too narrow, too wide; biased low, high: they lie below, above
  the truths. A check fails at p up to 0.01, corrected for the number of parameters.

examples:
  jaxlfi diagnose runs/npe
  jaxlfi diagnose runs/edge --reference posterior,ok --truths 200
  jaxlfi diagnose runs/edge --reference posterior --out runs/edge-at-its-posterior
  jaxlfi diagnose runs/gaussian --against reference.csv

"""
