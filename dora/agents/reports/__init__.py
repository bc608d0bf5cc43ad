"""Tables and figures of finished runs, and the paper's beside them."""
