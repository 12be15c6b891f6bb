"""
viser's client, drawn without antialiasing if the browser has no graphics card.

Antialiasing takes half of the time of a picture that the CPU renders, see
docs/how-to/view.md. The client requests it when it creates its canvas. viser has no option
for it, therefore a script at the beginning of the page changes the request.
"""

from collections.abc import Iterator
import contextlib
from pathlib import Path

import viser
import viser.infra

SOFTWARE_RENDERERS = 'SwiftShader|llvmpipe|softpipe|software|Basic Render'
SCRIPT = """<script>(() => {
  const gl = document.createElement('canvas').getContext('webgl');
  const info = gl && gl.getExtension('WEBGL_debug_renderer_info');
  const renderer = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : '';
  gl?.getExtension('WEBGL_lose_context')?.loseContext();
  if (!/RENDERERS/i.test(renderer)) return;
  const original = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, options) {
    return original.call(this, kind, String(kind).startsWith('webgl')
      ? {...options, antialias: false} : options);
  };
})();</script>""".replace('RENDERERS', SOFTWARE_RENDERERS)


class _Index:
    """The client's page with the script, in place of its file."""

    def __init__(self, path: Path):
        self._path = path

    def is_file(self) -> bool:
        """Whether the page is there."""
        return self._path.is_file()

    def read_bytes(self) -> bytes:
        """Content of the page."""
        head, begin, rest = self._path.read_bytes().partition(b'<head>')
        return head + begin + SCRIPT.encode() + rest


class _Folder:
    """The folder of the client, as far as viser's HTTP server uses it."""

    def __init__(self, path: Path):
        self._path = path

    def __truediv__(self, name: str) -> Path | _Index:
        """File of this name."""
        path = self._path / name
        return _Index(path) if name == 'index.html' else path


@contextlib.contextmanager
def served_with_script() -> Iterator[None]:
    """Let a viser server that is created in this context serve the page with the script."""
    server = viser.infra.WebsockServer

    def with_script(*args, **kwargs):
        if 'http_server_root' in kwargs:    # a keyword of viser's internal call
            kwargs['http_server_root'] = _Folder(kwargs['http_server_root'])
        return server(*args, **kwargs)

    viser.infra.WebsockServer = with_script     # type: ignore[assignment, misc]
    try:
        yield
    finally:
        viser.infra.WebsockServer = server      # type: ignore[misc]
