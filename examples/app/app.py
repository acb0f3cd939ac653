"""A Hugging Face Space: open its .hf.space address.

Its secret IGSR_PASSWORD is the password of the user igsr.
"""

import os
from pathlib import Path

from igsr.app import serve

serve(Path("scenes"), host="0.0.0.0", port=7860, password=os.environ["IGSR_PASSWORD"])
