// Packs files into a tar archive (POSIX ustar) without reading them: the browser reads them while it sends.

const BLOCK = 512;
const MOST_NAME = 100; // bytes

function octal(number, width) {
  return number.toString(8).padStart(width - 1, "0") + "\0";
}

/** The header block of a file. The same files always give the same bytes: no times, no owners. */
function header(name, size) {
  const text = new TextEncoder();
  const block = new Uint8Array(BLOCK);
  const put = (at, value) => block.set(typeof value === "string" ? text.encode(value) : value, at);
  const bytes = text.encode(name);
  if (bytes.length > MOST_NAME) throw new RangeError(`expected a file name of at most ${MOST_NAME} bytes; got ${name}: shorten it`);
  put(0, bytes);
  put(100, octal(0o644, 8));
  put(108, octal(0, 8));
  put(116, octal(0, 8));
  put(124, octal(size, 12));
  put(136, octal(0, 12));
  put(148, "        "); // the checksum is computed with spaces in its field
  put(156, "0");
  put(257, "ustar\0" + "00");
  put(148, octal(block.reduce((sum, byte) => sum + byte, 0), 7) + " ");
  return block;
}

/** The archive of files, by their names without folders. */
export function tar(files) {
  const parts = files.flatMap((file) => [header(file.name, file.size), file, new Uint8Array((BLOCK - (file.size % BLOCK)) % BLOCK)]);
  return new Blob([...parts, new Uint8Array(2 * BLOCK)]);
}
