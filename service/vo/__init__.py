"""The interfaces of the Virtual Observatory besides UWS: VOSI, DataLink, cut-outs, and lists with the columns of
ObsCore.
"""
