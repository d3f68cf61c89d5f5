// The passes of renderer/splats/renderer.py on WebGL 2: depth pushed back by the margin, weighted colours within it, division. Shaders are
// those of the product, as GLSL ES (renderer/splats/gles.py).

import { isLookedUp } from "./maps.js";
import { GROUP } from "./packed.js";
import { radiusAt } from "./tables.js";
import { NEAR_IN_RADII, viewBlock, visibleGroups } from "./view.js";

const UNITS = ["splats", "boxes", "running_counts", "groups", "codes", "cliplines", "weights", "ellipsoids", "colors", "shares", "atlas", "sums", "normals", "splat_maps", "map_frames", "map_colors", "map_depths"];
const AS_PHOTOGRAPHED = { towards: [0, 0, -1], ambient: 1, diffuse: 0 };
const DEPTH_SHADER = `precision highp float; precision highp sampler2D;
uniform sampler2D depths; uniform ivec2 at; out vec4 found;
void main() { found = vec4(texelFetch(depths, at, 0).r, 0.0, 0.0, 1.0); }`;

export class Renderer {
  constructor(canvas, shaders, { ownDepth = false } = {}) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: true, depth: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("this browser, or its graphics driver, has no WebGL 2");
    if (!gl.getExtension("EXT_color_buffer_float")) throw new Error("this graphics driver cannot draw into floats");
    Object.assign(this, { gl, canvas, shaders, programs: new Map(), targets: null });
    this.clip = ownDepth ? null : gl.getExtension("EXT_clip_control");
    this.clip?.clipControlEXT(this.clip.LOWER_LEFT_EXT, this.clip.ZERO_TO_ONE_EXT);
    this.multi = gl.getExtension("WEBGL_multi_draw");
    this.canBlendWide = !!gl.getExtension("EXT_float_blend");
    this.view = gl.createBuffer();
    this.scene = gl.createBuffer();
    this.empty = gl.createVertexArray();
    gl.activeTexture(gl.TEXTURE0 + UNITS.length); // where textures are made and filled
  }

  /** Draw `scene` from `view` ({ rotation rows, eye against the origin, fx, fy, cx, cy, width, height }) into the renderer's targets. */
  render(scene, view, look = {}) {
    const groups = scene.choose(view, visibleGroups(scene, view), look.mostSplats ?? Infinity);
    this.begin(scene, view, look);
    this.drawDepth(groups);
    this.drawColors(groups);
    return this.end(groups);
  }

  /** Empty targets; then come `drawDepth` of all groups, in any number of calls, `drawColors` of all of them, and `end`. `wide` sums take any number of splats. */
  begin(scene, view, { maxAtoms = 16, light = null, section = null, wide = false }) {
    const { gl } = this, drawn = light ? new Set([...scene.drawn, "relighting", "normal_smoothing"]) : scene.drawn;
    const against = (corner) => corner.map((x, i) => x - view.eye[i]);
    this.section = section && { section_low: against(section.low), section_high: against(section.high) };
    this.begun = { scene, view, drawn, maxAtoms, light: light || AS_PHOTOGRAPHED };
    this.use(scene, view, drawn, wide);
    gl.bindVertexArray(this.empty);
    gl.depthMask(true);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets.depth);
    gl.clearBufferfv(gl.DEPTH, 0, [0]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets.sums);
    for (let i = 0; i < this.targets.colors.length; ++i) gl.clearBufferfv(gl.COLOR, i, [0, 0, 0, 0]);
  }

  /** The picture of the groups that were drawn; returns how many splats they have. */
  end(groups) {
    const { scene, view, drawn, light } = this.begun;
    this.resolve(drawn, light);
    this.shown = { scene, view, splats: groups.reduce((n, group) => n + scene.splatsOf(group), 0) };
    return this.shown.splats;
  }

  use(scene, view, drawn, asked) {
    const { gl } = this, wide = (asked || scene.drawn.has("accumulation")) && this.canBlendWide;
    this.targets = this.targetsOf(view.width, view.height, wide, drawn.has("normal_smoothing"));
    gl.viewport(0, 0, view.width, view.height);
    for (const [i, [buffer, data]] of [[this.view, viewBlock(view, scene.header)], [this.scene, scene.uniformBlock()]].entries()) {
      gl.bindBuffer(gl.UNIFORM_BUFFER, buffer);
      gl.bufferData(gl.UNIFORM_BUFFER, data, gl.DYNAMIC_DRAW);
      gl.bindBufferBase(gl.UNIFORM_BUFFER, i, buffer);
    }
    for (const [name, words] of Object.entries(scene.textures)) this.bind(name, words.texture);
    if (scene.atlas) this.bind("atlas", scene.atlas);
    if (scene.maps) for (const name of ["map_colors", "map_depths"]) this.bind(name, scene.maps[name], gl.TEXTURE_2D_ARRAY);
  }

  bind(name, texture, target = this.gl.TEXTURE_2D) {
    this.gl.activeTexture(this.gl.TEXTURE0 + UNITS.indexOf(name));
    this.gl.bindTexture(target, texture);
    this.gl.activeTexture(this.gl.TEXTURE0 + UNITS.length);
  }

  drawDepth(groups) {
    const { gl, begun: { scene, drawn } } = this, { batches } = scene.header;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets.depth);
    gl.disable(gl.BLEND);
    gl.enable(gl.DEPTH_TEST);
    gl.depthMask(true);
    gl.depthFunc(gl.GREATER);
    if (scene.nLeading) {
      for (const [some, look] of this.byMaps(groups))
        this.drawGroups(scene, this.program("visibility", { LEADING: scene.nLeading < batches.length, ...scene.defines, ...look }), some, null, { n_leading: scene.nLeading });
    }
    for (let batch = scene.nLeading; batch < batches.length; ++batch)
      this.drawBatch(scene, groups, batch, "visibility", this.definesOf("visibility", drawn, batches[batch]), {});
  }

  drawColors(groups) {
    const { gl, begun: { scene, drawn, maxAtoms, light } } = this, { batches, n_turns } = scene.header;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets.sums);
    gl.depthMask(false);
    gl.depthFunc(gl.GEQUAL);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    const coded = groups.filter((group) => scene.isCoded(group)), flat = groups.filter((group) => !scene.isCoded(group));
    batches.forEach((batch, i) => {
      for (const [some, atoms] of [[coded, Math.min(batch.n_atoms, maxAtoms)], [flat, 0]]) {
        const ofAtoms = atoms ? drawn : new Set([...drawn].filter((name) => name !== "mip_levels" && name !== "level_blending"));
        const defines = { N_ATOMS: atoms, ...this.definesOf("attribute", ofAtoms, batch), TURNED: n_turns > 1 && atoms > 0, FEWER: atoms > 0 && atoms < batch.n_atoms };
        if (some.length) this.drawBatch(scene, some, i, "attribute", defines, light);
      }
    });
  }

  drawBatch(scene, groups, batch, pass, defines, light) {
    const { batches } = scene.header, leads = !batch && scene.nLeading === 1 && !(batches[1] && batches[0].n_atoms);
    for (const [some, look] of this.byMaps(groups)) {
      const program = this.program(pass, { ...defines, ...scene.defines, ...look, BY_BATCH: !leads, LEADING: leads && batches.length > 1 });
      this.drawGroups(scene, program, some, leads ? null : batch, { batch, n_leading: 1, atoms_stored: batches[batch].n_atoms }, light);
    }
  }

  // Groups without a splat that is looked up in its map have programs without maps, which are faster.
  byMaps(groups) {
    const { scene, view } = this.begun;
    if (!scene.defines.MAPPED) return [[groups, {}]];
    const isNear = (group) => isLookedUp(scene, group, view);
    return [[groups.filter((group) => !isNear(group)), { MAPPED: 0, CLIPLINE: 0 }], [groups.filter(isNear), {}]].filter(([some]) => some.length);
  }

  // Three vertices a splat: those of one batch of each group, or of all (`batch` null).
  drawGroups(scene, program, groups, batch, numbers, light = {}) {
    const { gl, multi } = this, firsts = [], counts = [];
    for (const group of groups) {
      const n = batch === null ? scene.splatsOf(group) : scene.counts[group][batch];
      if (n) firsts.push(3 * GROUP * scene.pool.slotOf[group]), counts.push(3 * n);
    }
    if (!firsts.length) return;
    this.start(program, numbers, light);
    if (multi) multi.multiDrawArraysWEBGL(gl.TRIANGLES, Int32Array.from(firsts), 0, Int32Array.from(counts), 0, firsts.length);
    else firsts.forEach((first, i) => gl.drawArrays(gl.TRIANGLES, first, counts[i]));
  }

  start({ program, uniforms }, numbers, light) {
    const { gl } = this;
    gl.useProgram(program);
    for (const [name, value] of Object.entries(numbers)) if (uniforms[name]) gl.uniform1ui(uniforms[name], value);
    for (const [name, value] of Object.entries(this.section || {})) if (uniforms[name]) gl.uniform3fv(uniforms[name], value);
    if (uniforms.towards_light) {
      gl.uniform3fv(uniforms.towards_light, light.towards);
      gl.uniform1f(uniforms.ambient, light.ambient);
      gl.uniform1f(uniforms.diffuse, light.diffuse);
    }
  }

  resolve(drawn, light) {
    const { gl, targets } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, targets.picture);
    gl.disable(gl.BLEND);
    gl.disable(gl.DEPTH_TEST);
    targets.colors.forEach((texture, i) => this.bind(["sums", "normals"][i], texture));
    this.start(this.program("resolve", this.definesOf("resolve", drawn, null)), {}, light);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** The picture onto the canvas, of any size; rows of pictures run downwards. */
  present() {
    const { gl, canvas, targets: { width, height, picture } } = this;
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, picture);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.blitFramebuffer(0, 0, width, height, 0, canvas.height, canvas.width, 0, gl.COLOR_BUFFER_BIT, width === canvas.width ? gl.NEAREST : gl.LINEAR);
  }

  /** Until all is drawn: browsers hand commands on, and `finish` does not wait for them. */
  wait() {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets.picture);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  /** The picture as RGBA bytes, top row first; alpha is 0 where nothing is seen. */
  pixels() {
    const { gl, targets: { width, height, picture } } = this, bytes = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, picture);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    return bytes;
  }

  /** The point of the surface at a pixel of the last picture, against the origin; null where there is none. */
  pointAt(x, y) {
    const { gl, targets, shown: { scene, view } } = this, [column, row] = [Math.floor(x), Math.floor(y)];
    if (column < 0 || row < 0 || column >= targets.width || row >= targets.height) return null;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.probe ??= this.target([[1, 1, gl.R32F]]).framebuffer);
    gl.viewport(0, 0, 1, 1);
    gl.disable(gl.BLEND);
    gl.disable(gl.DEPTH_TEST);
    this.bind("sums", targets.depthTexture);
    const { program, uniforms } = this.program("depth", {});
    gl.useProgram(program);
    gl.uniform2i(uniforms.at, column, row);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    const found = new Float32Array(4);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, found);
    if (!(found[0] > 0)) return null;
    if (found[0] < 2 ** -30) found[0] *= 2 ** 40; // of the second tier, see station_map.glsl
    const { header } = scene, ray = [(column + 0.5 - view.cx) / view.fx, (row + 0.5 - view.cy) / view.fy, 1];
    const pushed = (NEAR_IN_RADII * header.radius) / found[0];
    const pointOf = (radius) => {
      const width = Math.max(radius, pushed / Math.min(view.fx, view.fy)); // a splat below a pixel is drawn as wide as one
      const z = (pushed - (header.margin_radii * width) / Math.hypot(...ray)) / (1 + 1e-5); // what the depth pass has added
      return view.eye.map((e, i) => e + z * (view.rotation[0][i] * ray[0] + view.rotation[1][i] * ray[1] + view.rotation[2][i]));
    };
    return pointOf(radiusAt(scene, scene.kept, pointOf(header.radius)));
  }

  // --- programs and targets

  definesOf(pass, drawn, batch) {
    const defines = {};
    for (const [name, { define, passes, flag }] of Object.entries(this.shaders.parts))
      if (passes.includes(pass)) defines[define] = flag ? !!batch?.[flag] : drawn.has(name);
    return defines;
  }

  program(pass, defines) {
    const on = Object.entries({ ...defines, OWN_DEPTH: !this.clip && pass !== "resolve" && pass !== "depth", SECTION: !!this.section && pass !== "resolve" }).filter(([, value]) => value);
    const key = pass + on.map(([name, value]) => ` ${name}=${Number(value)}`).join("");
    if (!this.programs.has(key)) this.programs.set(key, this.compiled(pass, on.map(([name, value]) => `#define ${name} ${Number(value)}\n`).join("")));
    return this.programs.get(key);
  }

  compiled(pass, defines) {
    const { gl, shaders: { version, sources } } = this, program = gl.createProgram();
    const texts = pass === "depth" ? [sources["resolve.vert"], DEPTH_SHADER] : [sources[pass + ".vert"], sources[pass + ".frag"]];
    const parts = texts.map((source, i) => {
      const shader = gl.createShader([gl.VERTEX_SHADER, gl.FRAGMENT_SHADER][i]);
      gl.shaderSource(shader, `${version}\n${defines}${source}`);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      return shader;
    });
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS))
      throw new Error(`the shaders of pass ${pass} do not work here: ${[...parts.map((p) => gl.getShaderInfoLog(p)), gl.getProgramInfoLog(program)].join(" ")}`);
    gl.useProgram(program);
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); ++i) {
      const { name } = gl.getActiveUniform(program, i);
      uniforms[name] = gl.getUniformLocation(program, name);
      if (UNITS.includes(name)) gl.uniform1i(uniforms[name], UNITS.indexOf(name));
      if (name === "depths") gl.uniform1i(uniforms[name], UNITS.indexOf("sums"));
    }
    for (const [i, name] of ["View", "Scene"].entries()) {
      const block = gl.getUniformBlockIndex(program, name);
      if (block !== gl.INVALID_INDEX) gl.uniformBlockBinding(program, block, i);
    }
    return { program, uniforms };
  }

  targetsOf(width, height, wide, smooth) {
    const { gl, targets: kept } = this;
    if (kept && kept.width === width && kept.height === height && kept.wide === wide && kept.smooth === smooth) return kept;
    kept?.resources.forEach(({ texture, framebuffer }) => { gl.deleteTexture(texture); gl.deleteFramebuffer(framebuffer); });
    const depth = this.target([[width, height, gl.DEPTH_COMPONENT32F]]);
    const colors = [[width, height, wide ? gl.RGBA32F : gl.RGBA16F], ...(smooth ? [[width, height, gl.RGBA16F]] : [])];
    const sums = this.target(colors, depth.textures[0]), picture = this.target([[width, height, gl.RGBA8]]);
    const resources = [depth, sums, picture].flatMap(({ textures, framebuffer }) => [...textures.map((texture) => ({ texture })), { framebuffer }]);
    return { width, height, wide, smooth, resources, depth: depth.framebuffer, depthTexture: depth.textures[0], sums: sums.framebuffer,
      colors: sums.textures, picture: picture.framebuffer };
  }

  target(sizes, depth = null) {
    const { gl } = this, framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const textures = sizes.map(([width, height, format], i) => {
      const texture = gl.createTexture(), isDepth = format === gl.DEPTH_COMPONENT32F;
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
      for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, isDepth ? gl.DEPTH_ATTACHMENT : gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
      return texture;
    });
    if (depth) gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depth, 0);
    if (textures.length > 1) gl.drawBuffers(textures.map((_, i) => gl.COLOR_ATTACHMENT0 + i));
    return { framebuffer, textures };
  }
}
