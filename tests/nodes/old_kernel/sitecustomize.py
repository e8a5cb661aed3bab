"""Makes Python see an old kernel, so that rosgraph's servers speak HTTP/1.0, as on a kernel before 4.16."""

import platform

platform.release = lambda: "4.9.0"
