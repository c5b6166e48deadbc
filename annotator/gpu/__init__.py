"""The interface `annotator.rcv.compute.Compute` on a GPU, with torch."""
