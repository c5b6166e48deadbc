"""What is wrong with labels and datasets: rules that both checks share, and the check of datasets."""
