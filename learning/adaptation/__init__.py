"""What the main method does with its time: in which order, on which core, from which guesses."""
