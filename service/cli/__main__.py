"""``python -m service.cli``: the ``heliopsf`` command."""

from service.cli.main import main

main()
