"""What tasks read and keep: transits, PSFs, solutions, products and reports."""
