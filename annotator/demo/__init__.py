"""The demo: the whole loop on a generated recording, labelled by a simulated operator."""
