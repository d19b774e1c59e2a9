"""Training: batches, losses, the loop, checkpoints."""

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
