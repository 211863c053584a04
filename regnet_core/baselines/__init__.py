"""Published methods to compare with: samplers that need no weights, and learned ones, trained on our data."""

LEARNED = ("gpd-3", "gpd-12", "pointnetgpd", "s4g")
"""The learned ones by name; zoo.py has what they are."""
