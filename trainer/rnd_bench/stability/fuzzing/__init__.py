"""Fuzzing of every reader: valid files are damaged by structure and read in processes that may die."""
