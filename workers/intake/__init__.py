"""From what a user sends to catalogue rows and resolved jobs, with estimates of their cost."""
