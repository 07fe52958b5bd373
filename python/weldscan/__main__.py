"""The program: `weldscan`, or `python -m weldscan`. The commands are imported inside the error boundary."""

import os


def main() -> None:
    """The entry point: whatever happens, at most one line of complaint, and the exit code of the contract."""
    try:
        from weldscan.faces.cli import boundary  # an interrupt may fall into this import already

        boundary.run(_commands)
    except KeyboardInterrupt:  # before the boundary stood
        try:
            os.write(2, b"weldscan: interrupted\n")
        finally:
            os._exit(130)


def _commands() -> None:
    from weldscan.faces.cli.app import app

    app()


if __name__ == "__main__":
    main()
