"""Points and rigid motions in NumPy float64: the tools the other rooms share."""
