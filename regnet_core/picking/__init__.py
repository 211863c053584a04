"""Bin picking in physics: a camera, a detector, a policy and a hand empty a bin, again and again."""
