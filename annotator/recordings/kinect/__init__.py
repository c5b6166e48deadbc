"""Azure Kinect: recordings and connected devices."""
