"""Published methods for choosing training domains, for comparison with a posterior.

| module | source | based on | result |
|---|---|---|---|
| `adr` | OpenAI et al., 2019 | the policy's performance at the bounds of its ranges | a box that grows and shrinks |
| `simopt` | Chebotar et al., 2019 | the discrepancy of simulated and real trajectories | a Gaussian, updated in steps |
| `dropo` | Tiboni et al., 2022 | the likelihood of logged transitions | an uncorrelated Gaussian |

All work in inference space, as posteriors do: a mass that is inferred as its logarithm is randomised as its logarithm.
"""
