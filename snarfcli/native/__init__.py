"""Bindings of the native kernels: the C++ library through ctypes, CUDA kernels through NVRTC and the driver."""
