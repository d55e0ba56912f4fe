"""What each command of `zermelo` does."""
