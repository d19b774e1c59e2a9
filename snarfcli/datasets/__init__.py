import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
