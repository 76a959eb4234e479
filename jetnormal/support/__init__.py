"""Small services for every other package: devices and threads, compilation, reports."""
