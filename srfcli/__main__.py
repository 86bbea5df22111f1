"""`python -m srfcli` is `srf`."""

from srfcli.cli.main import main

if __name__ == "__main__":
    main()
