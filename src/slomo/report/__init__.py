"""What a person looks at: the side-by-side video, plots and tables."""
