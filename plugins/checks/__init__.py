"""The built-in checks: every row of the stability matrix (`cases`), one module per family."""
