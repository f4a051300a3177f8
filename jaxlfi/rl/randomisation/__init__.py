"""Published methods for choosing training domains, for comparison with a posterior.

| module | source | from what | gives |
|---|---|---|---|
| `adr` | OpenAI et al., 2019 | how the policy fares at the bounds of its ranges | a box that grows and shrinks |
| `simopt` | Chebotar et al., 2019 | how far simulated trajectories are from real ones | a Gaussian, step by step |
| `dropo` | Tiboni et al., 2022 | the likelihood of logged transitions | an uncorrelated Gaussian |

All work in inference space, as posteriors do: a mass that is inferred as its logarithm is randomised as its logarithm.
"""
