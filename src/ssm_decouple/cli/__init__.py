"""The command `ssm-decouple`."""

from ssm_decouple.cli.commands import app, main

__all__ = ["app", "main"]
