"""The main method's network: a value function that knows its query."""
