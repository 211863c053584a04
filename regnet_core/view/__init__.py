"""Pictures of detections: an interactive page (``html``) and a PNG (``png``), both without a GPU or a display."""

from regnet_core.view.html import write_html
from regnet_core.view.png import render_panels, render_png
from regnet_core.view.render import RenderStyle
from regnet_core.view.scene import ViewScene

__all__ = ["RenderStyle", "ViewScene", "render_panels", "render_png", "write_html"]
