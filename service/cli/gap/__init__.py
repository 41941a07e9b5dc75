"""The command `heliopsf gap`: diagnose a transit, and judge the diagnosis on blind sets."""
