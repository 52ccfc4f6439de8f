// Builds src/ into ../sfms_robot/viewer/static/. With --check: says whether what is there is what src/ gives.

import { build } from 'esbuild';
import { execFileSync } from 'node:child_process';
import { cpSync, existsSync, mkdirSync, mkdtempSync, readFileSync, readdirSync, rmSync, statSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { dirname, join, relative } from 'node:path';
import { fileURLToPath } from 'node:url';

const here = dirname(fileURLToPath(import.meta.url));
const target = join(here, '..', 'sfms_robot', 'viewer', 'static');
const SHARED = ['mesh.js', 'skin.js']; // of the page and of that of `evaluate people`: files of their own, which both load
const VISION = join(here, 'node_modules/@mediapipe/tasks-vision/wasm');
const PACKED = { maxBuffer: 2 ** 26 };
const LICENSES = `urdf-loader: Apache License 2.0, Copyright Garrett Johnson, https://github.com/gkjohnson/urdf-loaders
@mediapipe/tasks-vision: Apache License 2.0, Copyright The MediaPipe Authors, https://github.com/google-ai-edge/mediapipe
three: as follows

`;

async function built(folder) {
  const common = { absWorkingDir: here, outdir: folder, minify: true, target: 'es2022', legalComments: 'none', logLevel: 'warning' };
  await build({
    ...common, bundle: true, splitting: true, format: 'esm', chunkNames: '[name]', external: SHARED.map((file) => `./${file}`),
    entryPoints: { app: 'src/main.js', people: 'src/people.js', 'voice-worklet': 'src/voice-worklet.js' },
  });
  await build({ ...common, entryPoints: [...SHARED, 'app.css', 'people.css'].map((file) => `src/${file}`) });
  for (const file of ['index.html', 'people.html']) cpSync(join(here, 'src', file), join(folder, file));
  mkdirSync(join(folder, 'vision'), { recursive: true });
  cpSync(join(VISION, 'vision_wasm_internal.js'), join(folder, 'vision/vision_wasm_internal.js'));
  // A fifth of its size; the server unpacks it for who asks for the plain name.
  const packed = execFileSync('xz', ['-9e', '-T1', '-c', join(VISION, 'vision_wasm_internal.wasm')], PACKED);
  writeFileSync(join(folder, 'vision/vision_wasm_internal.wasm.xz'), packed);
  writeFileSync(join(folder, 'LICENSES.txt'), LICENSES + readFileSync(join(here, 'node_modules/three/LICENSE'), 'utf8'));
}

function content(file) { // of what is packed what is in it: packers differ from machine to machine
  return file.endsWith('.xz') ? execFileSync('xz', ['-d', '-c', file], PACKED) : readFileSync(file);
}

function files(folder) {
  return readdirSync(folder, { recursive: true }).filter((name) => statSync(join(folder, name)).isFile()).sort();
}

if (process.argv.includes('--check')) {
  const fresh = mkdtempSync(join(tmpdir(), 'page-'));
  await built(fresh);
  const names = [...new Set([...files(fresh), ...(existsSync(target) ? files(target) : [])])];
  const differ = names.filter((name) => {
    const [a, b] = [join(fresh, name), join(target, name)];
    return !existsSync(a) || !existsSync(b) || !content(a).equals(content(b));
  });
  rmSync(fresh, { recursive: true });
  if (differ.length) {
    console.error(`${relative(process.cwd(), target)} is not what src/ gives: ${differ.join(', ')}; npm run build`);
    process.exit(1);
  }
} else {
  rmSync(target, { recursive: true, force: true });
  await built(target);
}
