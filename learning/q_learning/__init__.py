"""Model-free regulation of linear robots: the law that converges and the papers' law."""
