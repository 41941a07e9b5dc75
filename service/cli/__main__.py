"""``python -m service.cli``: the ``heliopsf`` command."""

from service.start import main

main()
