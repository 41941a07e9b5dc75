"""Commands about jobs and the products that they make."""
