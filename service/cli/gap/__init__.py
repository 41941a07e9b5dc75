"""The command `heliopsf gap`: diagnoses a transit, and measures how often the diagnosis is right on blind sets."""
