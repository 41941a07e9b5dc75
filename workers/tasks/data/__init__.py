"""Reads and keeps the data of tasks: PSFs, solutions, products and reports."""
