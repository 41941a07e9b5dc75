"""The evidence of a diagnosis: the cells of the discs, the blocks of the unocculted field, and a linear model of
both.
"""
