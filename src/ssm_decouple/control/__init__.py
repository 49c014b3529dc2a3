"""The selective law and the compiled algebra that it stands on."""
