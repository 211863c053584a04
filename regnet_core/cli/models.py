"""``regnet models``: what can detect grasps."""

from __future__ import annotations

from typing import Annotated

import typer


def models(
    card: Annotated[
        str | None,
        typer.Option(help="Show the card of this network instead: training, metrics, limits.", metavar="NAME"),
    ] = None,
) -> None:
    """List the models that `regnet detect --model` takes, one a line: networks, then baselines, learned ones first."""
    from regnet_core.models import available_models
    from regnet_core.weights import model_card

    if card is not None:
        typer.echo(model_card(card).rstrip())
        return
    for name in available_models():
        typer.echo(name)
