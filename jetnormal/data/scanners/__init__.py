"""Virtual scanners: clouds as sensors see a surface."""
