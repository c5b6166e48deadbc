"""The work on many points, on a graphics processor through torch: what `annotator.rcv.compute.Compute` asks for."""
