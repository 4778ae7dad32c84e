"""``python -m lmshealth`` is the command line."""

from lmshealth.cli import main

if __name__ == "__main__":
    main(prog_name="lmshealth")
