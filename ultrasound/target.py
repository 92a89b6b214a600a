"""What of a patient there may be to see: the tumour with a margin around it, the tumour alone, the whole
organ.
"""

from typing import Literal

Target = Literal["margin", "tumour", "organ"]
