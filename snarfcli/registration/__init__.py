"""Fitting a body to scans: the poses, the place and the shape of the body that the scans show."""

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
