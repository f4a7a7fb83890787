"""``python -m fourbar_codegen`` and ``fourbar``: the command line as a process, which ends with a line and a code."""

import os
import sys

from fourbar_codegen.errors import INTERRUPTED

__all__ = ["main"]


def main() -> None:
    """Run the command line; whatever stops it, say so in one line and exit."""
    code: object = 0
    try:
        try:
            from click import ClickException
            from click.exceptions import Abort

            from fourbar_codegen.cli import main as command

            try:
                code = command(prog_name="fourbar", standalone_mode=False)
            except ClickException as error:
                error.show()
                code = error.exit_code
            except Abort:  # click's name for an interrupt
                raise KeyboardInterrupt from None
        except SystemExit as error:
            code = error.code
        sys.stdout.flush()
    except KeyboardInterrupt:
        _end("Interrupted.", INTERRUPTED)
    except BrokenPipeError:  # whoever reads has seen enough
        _end("", 1)
    except OSError as error:
        _end(f"Error: the output cannot be written: {error.strerror or error}.", 1)
    sys.exit(code)  # type: ignore[arg-type]  # what click has given


def _end(message: str, code: int) -> None:
    """Exit without writing what stdout still holds."""
    if message:
        os.write(2, f"{message}\n".encode())
    os._exit(code)


if __name__ == "__main__":
    main()
