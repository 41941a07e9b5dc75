"""Point-spread functions of solar imagers: heliopsf computes and fits them, and deconvolves images with them."""


def software_version() -> str:
    """Version of the installed package, as recorded in products."""
    from importlib.metadata import version

    return version("heliopsf")
