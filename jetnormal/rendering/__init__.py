"""Pictures of clouds and meshes, made on the CPU without a display.

scene -> camera -> surfels (clouds: splats, meshes: rays) -> light -> PNG
"""
