"""Linear regulation by learned gains against Riccati: system files, simulation, study."""
