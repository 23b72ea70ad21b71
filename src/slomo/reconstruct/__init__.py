"""From a clip to key points in the world: decoding, masks and flow, camera and ground, skeleton fit."""
