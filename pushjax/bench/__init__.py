"""How fast, and how exact: what `pushjax bench` measures. Nothing else imports this."""
