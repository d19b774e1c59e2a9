"""The papers' tables and figures: experiments, their plans, the jobs that run them, and the reports."""
