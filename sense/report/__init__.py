"""Reports of sense: files, figures and sections of the HTML report."""
