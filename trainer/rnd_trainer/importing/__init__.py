"""Videos and data sets of other programs, made into captures."""
