"""The study of policies: which simulators a policy should be trained on so that it does well on an object."""
