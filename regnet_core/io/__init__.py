"""Point clouds from files (``files``), from MCAP bags (``bags``) and from PointCloud2 buffers (``pointcloud2``).

Nothing here needs ROS. Each module is imported by itself, so that a node which decodes messages needs no bag library.
"""
