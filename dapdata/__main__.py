"""`python -m dapdata` is the `dapdata` command."""

from dapdata.cli import main

if __name__ == "__main__":
    main()
