"""Bring-up checks of the real robot. They move nothing and change no setting."""
