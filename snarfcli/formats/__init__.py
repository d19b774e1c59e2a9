"""Readers for the files of other programs: they return plain structures and execute nothing that a file contains."""
