"""The jobs and bulk runs of an owner that streams of events follow."""
