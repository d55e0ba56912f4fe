"""Meta value learning without any grid: exact trajectories, residuals, a regulator inside."""
