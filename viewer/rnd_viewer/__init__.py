"""Everything people look at: frames and videos, live pages, conversions, reports."""
