"""Values on conforming simplicial meshes that are refined where it pays."""
