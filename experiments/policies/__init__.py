"""The study of policies: on which simulators should a policy be trained to perform well on an object?"""
