"""The package `snarfcli.export`, for tools that read code without running it."""
