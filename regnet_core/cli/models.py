"""``regnet models``: what can detect grasps."""

from __future__ import annotations

import typer


def models() -> None:
    """List the models that `regnet detect --model` takes, one a line."""
    from regnet_core.detector import available_models

    for name in available_models():
        typer.echo(name)
