"""View an avatar in the browser with viser."""

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
