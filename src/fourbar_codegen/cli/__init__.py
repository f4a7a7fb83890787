"""The command line: commands, options, models, and arithmetic expressions in options."""

from fourbar_codegen.cli.commands import main

__all__ = ["main"]
