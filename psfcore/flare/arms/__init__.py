"""Measures the arms of a mesh's diffraction pattern around a flare."""

from psfcore.flare.arms.measure import ArmMeasurement, Peak, measure_arms

__all__ = ["ArmMeasurement", "Peak", "measure_arms"]
