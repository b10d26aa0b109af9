"""Lets dm_control draw through EGL. Import it before dm_control.

lxml has a libxml2 of its own, and Mesa's EGL loads the system's. Where lxml's functions are not bound before that, it calls the
system's with its own data and crashes.
"""

import os
import sys

lazily = sys.getdlopenflags()
sys.setdlopenflags(os.RTLD_NOW)
import lxml.etree  # noqa: E402, F401

sys.setdlopenflags(lazily)
