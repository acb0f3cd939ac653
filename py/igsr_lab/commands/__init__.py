"""The commands of ``python -m igsr_lab``, a file each."""
