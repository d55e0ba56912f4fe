"""RRT-Q^X in Drake's Simulator: scenarios, diagram, controllers, pictures, study."""
