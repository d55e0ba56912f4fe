"""The live window in the browser."""
