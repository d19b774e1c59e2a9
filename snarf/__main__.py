"""`python -m snarf` is the `snarf` command."""

from snarfcli.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
