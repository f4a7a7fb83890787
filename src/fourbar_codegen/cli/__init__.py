"""The command line: commands, their options, the models that they name, and arithmetic in options."""

from fourbar_codegen.cli.commands import main

__all__ = ["main"]
