"""Turns uploads and requests of users into catalogue rows and resolved jobs, and estimates the cost of jobs."""
