"""The paper's reinforcement-learning baseline."""
