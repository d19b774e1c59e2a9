"""The store of processed samples: how samples are made from posed meshes, written, found and read."""

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
