"""The evidence of a diagnosis: cells of the discs, blocks of the unocculted field, and the linear model of both."""
