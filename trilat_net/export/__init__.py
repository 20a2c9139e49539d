"""A log for other tools: tables as CSV or Parquet, arrays for NumPy or MATLAB, messages for ROS 2."""
