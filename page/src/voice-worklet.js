// Runs in the audio thread: blocks of 128 samples in, 20 ms of 16-bit samples and their time out.

class VoicePieces extends AudioWorkletProcessor {
  #piece = new Int16Array(Math.round(sampleRate / 50));
  #filled = 0;

  process([[samples]]) {
    for (const sample of samples ?? []) {
      this.#piece[this.#filled++] = Math.max(-32768, Math.min(32767, Math.round(sample * 32767)));
      if (this.#filled === this.#piece.length) {
        this.port.postMessage({ piece: this.#piece.slice(), at: currentTime });
        this.#filled = 0;
      }
    }
    return true;
  }
}
registerProcessor('voice-pieces', VoicePieces);
