"""`python -m services.cli` is `splatpress`."""

from services.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
