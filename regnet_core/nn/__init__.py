"""REGNet V2: the network, its coders, matching and losses. Needs torch."""
