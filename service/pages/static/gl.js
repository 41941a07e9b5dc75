// Draws sheets of pixels with WebGL2. All numbers that decide what is seen (which texels, which level, which colour) come as tables
// from view.js and stretch.js. The shader only looks them up. It averages texels itself, because some phones cannot
// filter float textures.
import { LEVELS, NO_DATA } from "./stretch.js";
import { texelRanges } from "./view.js";

export const PLANES = ["before", "after", "quality", "error"];
const TABLES = ["columns", "rows", "limits", "colours"];
export const SHOWN = { before: 0, after: 1, change: 2 };

const VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1), 0, 1);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp isampler2D;
uniform sampler2D before, after, quality, error, limits, colours;
uniform isampler2D columns, rows;
uniform int shown;
uniform bool markQuality;
uniform float markError;
uniform vec3 noData;
out vec4 colour;

bool isNumber(float value) {
  return (floatBitsToUint(value) & 0x7f800000u) != 0x7f800000u;
}

// The mean of the finite texels, and whether there is one.
bool mean(sampler2D plane, ivec2 x, ivec2 y, out float found) {
  float count = 0.0;
  found = 0.0;
  for (int row = y.x; row < y.y; row++) {
    for (int column = x.x; column < x.y; column++) {
      float value = texelFetch(plane, ivec2(column, row), 0).r;
      if (!isNumber(value)) continue;
      found += value;
      count += 1.0;
    }
  }
  if (count > 1.0) found /= count;
  return count > 0.0;
}

int bitsOf(ivec2 x, ivec2 y) {
  int found = 0;
  for (int row = y.x; row < y.y; row++)
    for (int column = x.x; column < x.y; column++) found |= int(texelFetch(quality, ivec2(column, row), 0).r);
  return found;
}

int levelOf(float value) {
  int level = 0;
  for (int step = ${LEVELS / 2}; step > 0; step >>= 1)
    if (value >= texelFetch(limits, ivec2(level + step, 0), 0).r) level += step;
  return level;
}

void main() {
  ivec2 place = ivec2(gl_FragCoord.xy);
  ivec2 x = texelFetch(columns, ivec2(place.x, 0), 0).rg;
  ivec2 y = texelFetch(rows, ivec2(place.y, 0), 0).rg;
  if (x.x >= x.y || y.x >= y.y) discard;
  float value, other;
  bool known = shown == ${SHOWN.before} ? mean(before, x, y, value) : mean(after, x, y, value);
  if (shown == ${SHOWN.change}) {
    known = known && mean(before, x, y, other) && other > 0.0;
    value = 100.0 * (value - other) / other;
  }
  vec3 found = known ? texelFetch(colours, ivec2(levelOf(value), 0), 0).rgb : noData;
  if (markError >= 0.0) {
    float size, deviation;
    bool both = mean(after, x, y, size) && mean(error, x, y, deviation);
    if (both && 100.0 * deviation > markError * abs(size)) found = mix(found, vec3(0.0, 0.75, 1.0), 0.5);
  }
  if (markQuality && bitsOf(x, y) != 0) found = mix(found, vec3(1.0, 0.0, 0.6), 0.5);
  colour = vec4(found, 1.0);
}`;

/** Draws on a canvas. Throws an Error if the browser cannot. */
export class Renderer {
  constructor(canvas) {
    // The picture must stay: people save it, and the browser may ask for it at any time.
    const gl = canvas.getContext("webgl2", { antialias: false, depth: false, preserveDrawingBuffer: true });
    if (gl === null) throw new Error("expected WebGL2; this browser has none");
    this.gl = gl;
    this.start();
  }

  /** Create all objects on the graphics card; called again after the card has lost them. */
  start() {
    const { gl } = this;
    this.textures = new Map(); // for each sheet, its textures by plane
    this.largest = Math.min(gl.getParameter(gl.MAX_TEXTURE_SIZE), ...gl.getParameter(gl.MAX_VIEWPORT_DIMS));
    this.program = linked(gl);
    gl.useProgram(this.program);
    this.place = new Map();
    for (const [unit, name] of [...PLANES, ...TABLES].entries()) gl.uniform1i(this.uniform(name), unit);
    gl.uniform3fv(this.uniform("noData"), NO_DATA.map((part) => part / 255));
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    this.empty = this.texture(gl.R32F, 1, 1, gl.RED, gl.FLOAT, new Float32Array(1));
    this.tables = new Map();
    this.pictures = new Map(); // for each side ("before", "after", "change"), as it was drawn last
  }

  uniform(name) {
    if (!this.place.has(name)) this.place.set(name, this.gl.getUniformLocation(this.program, name));
    return this.place.get(name);
  }

  /** Copy the planes of a sheet to the graphics card, if they are not there. sheet: {x, y, step, nx, ny, planes: {before: Float32Array, ...}}. */
  hold(sheet) {
    const { gl } = this;
    if (!this.textures.has(sheet)) this.textures.set(sheet, new Map());
    const held = this.textures.get(sheet);
    for (const [name, pixels] of Object.entries(sheet.planes)) {
      if (!held.has(name)) held.set(name, this.texture(gl.R32F, sheet.nx, sheet.ny, gl.RED, gl.FLOAT, pixels));
    }
    return held;
  }

  /** Free the card's memory of a sheet. */
  release(sheet) {
    for (const texture of this.textures.get(sheet)?.values() ?? []) this.gl.deleteTexture(texture);
    this.textures.delete(sheet);
  }

  /**
   * Draw one picture. sheets: later sheets are drawn over earlier ones. panels: {left, width, from, to, shown}, device px: the axis of a
   * panel starts at `left` and has `width`; its part between `from` and `to` is drawn. shown: "before", "after" or "change".
   * look: {centre: {x, y}, zoom, limits and colours by what is shown, markQuality, markError (percent, or null)}.
   *
   * Each side is drawn once into a picture of its own and copied from there, so that a blink or a moved divider is one copy.
   */
  draw(sheets, panels, look) {
    const { gl } = this;
    for (const panel of panels) this.prepare(sheets, panel, look);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    for (const { left, from, to, shown } of panels) {
      if (to <= from) continue;
      const { height } = gl.canvas;
      gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.pictures.get(shown).frame);
      gl.blitFramebuffer(from - left, 0, to - left, height, from, 0, to, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  /** Draw the whole picture of a side, unless it is there already. */
  prepare(sheets, { width, shown }, look) {
    const { gl } = this;
    const { height } = gl.canvas;
    for (const sheet of sheets) this.hold(sheet);
    const wanted = [width, height, look.centre.x, look.centre.y, look.zoom, look.limits[shown], look.colours[shown], look.markQuality, look.markError];
    for (const sheet of sheets) wanted.push(sheet, this.textures.get(sheet).size);
    const kept = this.pictures.get(shown);
    if (kept?.of.length === wanted.length && kept.of.every((part, index) => part === wanted[index])) return;
    const picture = this.picture(shown, width, height);
    picture.of = wanted;
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, picture.frame);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    this.table("limits", look.limits[shown]);
    this.table("colours", look.colours[shown]);
    gl.uniform1i(this.uniform("shown"), SHOWN[shown]);
    for (const sheet of sheets) this.drawSheet(sheet, width, height, look);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  drawSheet(sheet, width, height, look) {
    const { gl } = this;
    const held = this.textures.get(sheet);
    for (const [unit, name] of PLANES.entries()) this.bind(unit, held.get(name) ?? this.empty);
    gl.uniform1i(this.uniform("markQuality"), look.markQuality && held.has("quality") ? 1 : 0);
    gl.uniform1f(this.uniform("markError"), look.markError !== null && held.has("error") ? look.markError : -1);
    this.table("columns", texelRanges(width, look.centre.x, look.zoom, { start: sheet.x, step: sheet.step, count: sheet.nx }));
    this.table("rows", texelRanges(height, look.centre.y, look.zoom, { start: sheet.y, step: sheet.step, count: sheet.ny }));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** The picture of a side: {frame, of: what it was drawn from}, made again for another size. */
  picture(shown, width, height) {
    const { gl } = this;
    const kept = this.pictures.get(shown);
    if (kept?.width === width && kept.height === height) return kept;
    if (kept !== undefined) {
      gl.deleteFramebuffer(kept.frame);
      gl.deleteTexture(kept.texture);
    }
    const texture = this.texture(gl.RGBA8, width, height, gl.RGBA, gl.UNSIGNED_BYTE, null);
    const frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.DRAW_FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    const made = { frame, texture, width, height, of: [] };
    this.pictures.set(shown, made);
    return made;
  }

  /** Give the shader a table of one row: pairs of integers, floats or colours. The same table is sent once. */
  table(name, values) {
    const { gl } = this;
    const unit = PLANES.length + TABLES.indexOf(name);
    const sent = this.tables.get(name);
    if (sent?.values === values) return;
    if (sent !== undefined) gl.deleteTexture(sent.texture);
    const made =
      values instanceof Int32Array
        ? this.texture(gl.RG32I, values.length / 2, 1, gl.RG_INTEGER, gl.INT, values)
        : values instanceof Float32Array
          ? this.texture(gl.R32F, values.length, 1, gl.RED, gl.FLOAT, values)
          : this.texture(gl.RGBA8, values.length / 4, 1, gl.RGBA, gl.UNSIGNED_BYTE, values);
    this.tables.set(name, { values, texture: made });
    this.bind(unit, made);
  }

  texture(format, width, height, part, type, values) {
    const { gl } = this;
    const made = gl.createTexture();
    // A separate texture unit is used, so that the new texture does not replace one that the next picture needs.
    gl.activeTexture(gl.TEXTURE0 + PLANES.length + TABLES.length);
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, part, type, values);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, axis, gl.CLAMP_TO_EDGE);
    return made;
  }

  bind(unit, texture) {
    this.gl.activeTexture(this.gl.TEXTURE0 + unit);
    this.gl.bindTexture(this.gl.TEXTURE_2D, texture);
  }
}

function linked(gl) {
  const program = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const said = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader)).join(" ");
    throw new Error(`expected the shader to compile; the browser said: ${gl.getProgramInfoLog(program)} ${said}`);
  }
  return program;
}
