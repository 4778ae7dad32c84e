"""``python -m lmshealth`` is the command line."""

from lmshealth.cli.main import main

if __name__ == "__main__":
    main(prog_name="lmshealth")
