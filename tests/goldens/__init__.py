"""What a refactoring leaves as it is: help, answers to programs, bytes of simulated trials."""
