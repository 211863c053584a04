"""End to end: real nodes in processes of their own, as users start them, between a publisher and a receiver."""
