"""How the service describes jobs, products, PSFs, reports and transits. The command line uses these models too, so they import no web framework."""
