"""A result as one page for the browser: report.html."""
