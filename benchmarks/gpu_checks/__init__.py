"""The parts of gpu_check.py: stages that measure, and what runs, times and reports them."""
