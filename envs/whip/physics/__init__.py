"""The physics of whipping scenes: the model, its parameters, and the engines that simulate it."""
