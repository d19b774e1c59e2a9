"""The papers' tables and figures: experiments, their plans, the jobs that run them, and the reports."""

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
