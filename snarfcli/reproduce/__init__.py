"""The papers' tables and figures in one command: what to run, how it is run, and what is written about it."""
