"""Subjects whose scans have no poses: reading the scans, fitting a body to all sequences, the files and the report."""

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
