"""Our methods compared with those of sbi and BayesFlow, on the same observations and simulators, in one program run."""
