"""Meta value learning as Xu and Zhu print it: Algorithms 1 and 2 and their networks."""
