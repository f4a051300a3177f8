/* A simulator in C for jaxlfi: a damped spring, pulled and let go, its position seen with noise.
 *
 *     cc -O2 -o spring spring.c -lm
 *     ./spring --theta 2.0 0.3 --seed 7
 *
 * theta: stiffness [N/m] and damping [N s/m] of a unit mass. Standard output: 40 positions [m], 0.25 s apart, as JSON.
 * A simulation that blows up is reported by its outcome; jaxlfi counts it, as it counts exit statuses and crashes.
 */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static uint64_t state;

/* splitmix64: the next uniform number in (0, 1). */
static double uniform(void) {
    uint64_t z = (state += 0x9e3779b97f4a7c15u);
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return ((double)((z ^ (z >> 31)) >> 11) + 0.5) / 9007199254740992.0;
}

static double normal(void) { return sqrt(-2.0 * log(uniform())) * cos(6.283185307179586 * uniform()); }

int main(int count, char **words) {
    double stiffness = 0.0, damping = 0.0;
    int given = 0;
    for (int i = 1; i < count; i++) {
        if (!strcmp(words[i], "--theta") && i + 2 < count) {
            stiffness = atof(words[++i]);
            damping = atof(words[++i]);
            given++;
        } else if (!strcmp(words[i], "--seed") && i + 1 < count) {
            state = strtoull(words[++i], NULL, 10);
            given++;
        }
    }
    if (given != 2) {
        fprintf(stderr, "expected --theta STIFFNESS DAMPING --seed SEED\n");
        return 2;
    }
    const double step = 0.005;
    double position = 1.0, velocity = 0.0;
    printf("{\"trajectory\": [");
    for (int record = 0; record < 40; record++) {
        for (int i = 0; i < 50; i++) { /* semi-implicit Euler */
            velocity -= step * (stiffness * position + damping * velocity);
            position += step * velocity;
        }
        if (!isfinite(position)) position = velocity = 0.0, given = 0;
        printf("%s%.9g", record ? ", " : "", position + 0.02 * normal());
    }
    printf("], \"outcome\": %d}\n", given ? 0 : 1);
    return 0;
}
