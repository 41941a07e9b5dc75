"""The verdict of a diagnosis: which effect causes the gap, where the gap lies, and how far the effect closes it."""
