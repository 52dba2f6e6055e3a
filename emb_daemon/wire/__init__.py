"""CAN wire: layouts from the DBC, AUTOSAR E2E, decoding and encoding of whole batches of frames."""
