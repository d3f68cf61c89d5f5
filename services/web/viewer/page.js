// The viewer on a server: its shaders are asked for there.

import { begin } from "./start.js";

begin(await (await fetch("/web/viewer/shaders.json")).json());
